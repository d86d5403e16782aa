"""The checked model -> IR: the one door between them."""
