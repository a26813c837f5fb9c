"""Backends of the cascade, a file each; `mint_hub.labelling.backends` names them all."""
