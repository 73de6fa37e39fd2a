"""Tasks of an experiment: in processes, resumable, each with the version of the code that did it."""
