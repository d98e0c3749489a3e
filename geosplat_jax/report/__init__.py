"""Results of a run: renderer, metrics, evaluation, relighting, exports. Host side."""
