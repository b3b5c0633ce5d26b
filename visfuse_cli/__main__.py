"""`python -m visfuse_cli` is the `visfuse` command."""

from visfuse_cli.cli import main

if __name__ == "__main__":
    main()
