"""Files of this package: one container for arrays and facts."""
