"""What rules can do to elements and fields in any world: decided from the checked model, never sampled."""
