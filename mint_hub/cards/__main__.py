"""Render the cards of a checkout: ``python -m mint_hub.cards [CHECKOUT]``, by default here."""

import argparse
from pathlib import Path

from mint_hub.cards.dataset import render
from mint_hub.loaders.atomic import replacing
from mint_hub.loaders.card import CARD


def main() -> None:
    """Write ``dataset_card/README.md``; ends with one line where its sources are wrong."""
    parser = argparse.ArgumentParser(prog="python -m mint_hub.cards", description=__doc__)
    parser.add_argument("checkout", type=Path, nargs="?", default=Path(), help="default: here")
    folder: Path = parser.parse_args().checkout / "dataset_card"
    try:
        card = render(folder)
    except ValueError as error:
        raise SystemExit(str(error)) from None
    with replacing(folder / CARD) as temporary:
        temporary.write_text(card, encoding="utf-8")


if __name__ == "__main__":
    main()
