"""Critical points with derivatives, cusps and fold curves."""
