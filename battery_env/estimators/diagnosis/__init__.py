"""The evidence of a record: what its samples, the gaps between them and the rest before the load say."""
