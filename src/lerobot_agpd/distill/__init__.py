"""The method: two stages, the adversary, the student mixin."""
