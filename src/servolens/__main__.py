"""``python -m servolens`` is the command ``servolens``."""

from servolens.cli import main

__all__: list[str] = []

if __name__ == "__main__":
    main()
