"""A fair comparison: tasks x methods x training seeds from one YAML, run, evaluated and reported."""
