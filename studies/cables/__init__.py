"""Cables held at both ends by robot arms: identified, learned and predicted from motion capture."""
