"""Test robots that PyElastica simulates, in the place of a real robot."""
