"""Talking to a vision-language model: questions, a server, patience with it, cassettes, costs, and checks."""
