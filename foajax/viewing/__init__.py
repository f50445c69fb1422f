"""Records games and makes pictures of them: videos, heat maps, pages."""
