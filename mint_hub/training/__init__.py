"""Two-stage training: recipes, windows of a corpus, the trainer, and the command behind the CLI.

    recipe = recipe_named("stage1")
    train(Request(recipe=recipe, data=("corpus",), out="run"))

Stage 1 trains everything on labels as a cascade makes them; stage 2 the camera head alone, on exact
camera paths. What is minimised is in `mint_hub.model.losses_mint`.
"""
