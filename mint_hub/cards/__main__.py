"""Render the cards of a checkout: ``python -m mint_hub.cards [CHECKOUT]``, by default here.

With ``--keep EVALUATION``, what `mint-hub evaluate -o EVALUATION` wrote is taken into the model's
card first.
"""

import argparse
from pathlib import Path

from mint_hub.cards import dataset, model
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.card import CARD


def main() -> None:
    """Write both cards' ``README.md``; ends with one line where a source is wrong.

    A checkout without ``model_card`` has the dataset's alone.
    """
    parser = argparse.ArgumentParser(prog="python -m mint_hub.cards", description=__doc__)
    add = parser.add_argument
    add("checkout", type=Path, nargs="?", default=Path(), help="default: here")
    add("--keep", type=Path, nargs="+", default=[], metavar="EVALUATION", help="its results, too")
    args = parser.parse_args()
    checkout: Path = args.checkout
    renderings = {"dataset_card": dataset.render}
    if (checkout / "model_card").is_dir():
        renderings["model_card"] = model.render
    try:
        for evaluation in args.keep:
            model.keep_results(evaluation, checkout / "model_card")
    except ValueError as error:
        raise SystemExit(str(error)) from None
    for name, render in renderings.items():
        try:
            card = render(checkout / name)
        except ValueError as error:
            raise SystemExit(str(error)) from None
        with replacing(checkout / name / CARD) as temporary:
            temporary.write_text(card, encoding="utf-8")


if __name__ == "__main__":
    main()
