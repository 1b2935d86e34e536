"""How far the hand that is found is from the hand that is there, where the truth is known."""
