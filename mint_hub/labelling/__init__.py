"""EgoPipeline: from raw egocentric video to corpus shards.

A video becomes a `Video` record, its pieces `Clip` records; stages are functions from record to
record (`stage`), the cascade is a list of them, and a runner carries records through it, here or
on Ray.
"""
