"""Imitation learning from demonstrators whose dynamics differ from your own robot's."""
