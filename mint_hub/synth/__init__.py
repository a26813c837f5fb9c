"""What was made, not recorded: synthetic clips with exact labels, and the licence-free hand.

`episodes` makes clips and corpora of them (`mint-hub synth`). What travels in `mint_hub/assets` is
made by scripts: `python -m mint_hub.synth.make_hand`, `draw_hand`, `make_sample`.
"""
