"""Made videos of a hand of which everything is known: what registration is measured against."""
