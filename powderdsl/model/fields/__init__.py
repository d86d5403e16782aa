"""Values of fields as written: by element, as words, cell by cell."""
