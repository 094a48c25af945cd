"""Procedural textures for ground, walls, facades and props."""
