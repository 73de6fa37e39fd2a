"""The tables of SST-Calib (Kodaira et al., ITSC 2022): its questions, its figures, and ours beside them.

The command is ``sst-graph experiment table1`` to ``table4`` (docs/measured/paper.md). Numbering and layout
are ours: they follow the questions of the paper, not its pages.
"""
