"""Entry point of `python -m knode_cosserat.cli`."""

from knode_cosserat.cli import main

main()
