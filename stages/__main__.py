"""``python -m stages``: the same as the ``insitu`` command."""

from pipeline.run.cli import main

if __name__ == "__main__":
    raise SystemExit(main())
