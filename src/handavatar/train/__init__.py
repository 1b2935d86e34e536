"""The training loop, its losses, its run folder, and the pre-training of the prior."""
