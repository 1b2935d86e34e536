"""What a long command needs and no hand knows."""
