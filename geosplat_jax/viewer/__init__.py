"""A run to look at in a browser, with the program's own renderer, also while it trains."""
