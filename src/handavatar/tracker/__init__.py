"""Our own tracker: a small network that sees a hand in a picture, taught by made pictures alone."""
