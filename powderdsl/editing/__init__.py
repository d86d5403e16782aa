"""What editors show of files: completion, hover texts, places of names, fixes, and one layout."""
