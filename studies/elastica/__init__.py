"""Robots that PyElastica simulates: a stand-in for a real robot."""
