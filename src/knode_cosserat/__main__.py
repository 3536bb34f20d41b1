"""`python -m knode_cosserat`: the program `knode-cosserat`."""

from knode_cosserat.cli import main

main()
