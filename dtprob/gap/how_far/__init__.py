"""How far a cause closes the gap, whose share is whose, and the rest modelled at its site."""
