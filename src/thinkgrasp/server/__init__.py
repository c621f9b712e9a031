"""Decisions over HTTP: the server (`thinkgrasp serve`), the paper's own API beside ours, and clients."""
