"""The summary of a batch: tables and one page."""
