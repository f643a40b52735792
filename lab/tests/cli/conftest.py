from tests.cli.conftest import photos, run  # noqa: F401
