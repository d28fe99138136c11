"""Demonstrations on disk."""

from oodil.pipeline.datasets.native import decode_demonstrations, encode_demonstrations, read_demonstrations, read_file

__all__ = ["decode_demonstrations", "encode_demonstrations", "read_demonstrations", "read_file"]
