"""The command line, the explorer, and the paper's figures."""
