"""What a run is made of: the schema of its configuration, and the files that are shipped."""
