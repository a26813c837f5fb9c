"""Episodes in and out: the schema, video decoding and (to come) the corpus readers and writers.

This folder is ``mint_hub.loaders``: ``mint_hub/loaders`` links to it. Under any other name its
classes would exist twice, so that is refused.
"""

if __name__ != "mint_hub.loaders":
    raise ImportError(
        f"this package is mint_hub.loaders and cannot be imported as {__name__!r}: "
        "write `import mint_hub.loaders` (and do not put the repository root first on sys.path)"
    )
