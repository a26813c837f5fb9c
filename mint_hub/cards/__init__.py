"""Cards rendered from schema, statistics and results: nothing in them is typed twice.

``python -m mint_hub.cards`` renders what a checkout has; a test fails where a committed card is not
a fresh rendering.
"""
