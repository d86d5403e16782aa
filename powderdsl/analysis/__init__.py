"""What can be said of rules without running them."""
