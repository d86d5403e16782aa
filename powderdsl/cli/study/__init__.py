"""What a study is checked for before it runs, where that takes the commands that it calls."""
