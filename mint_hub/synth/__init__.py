"""What was made, not recorded: the licence-free hand, the sample clip, and how they are drawn.

The generators are scripts (`python -m mint_hub.synth.make_hand`, `draw_hand`, `make_sample`); their
results travel in `mint_hub/assets`.
"""
