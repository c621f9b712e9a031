"""One module per command of `thinkgrasp`: its options, and what it prints."""
