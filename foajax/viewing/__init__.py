"""Recorded games and their pictures: videos, heat maps, pages."""
