"""The MINT network as transformers classes: configuration, model, processors, conversion."""
