"""The viewer: a run in a browser, drawn by the program's own renderer, also during training."""
