"""How a system is stepped in time and solved along the rod. No physics: only the general class is seen."""
