"""``envedit schema``: print the configuration's JSON Schema, or its reference."""

from __future__ import annotations

import json

from envedit.cli.console import make_parser


def main(argv: list[str] | None = None) -> int:
    """Print the schema; returns the exit code."""
    parser = make_parser(
        "schema",
        "Print every key of the configuration: as JSON Schema, by which editors complete and\n"
        "check TOML files, or as the page docs/configuration.md.",
        [
            "envedit schema > envedit.schema.json",
            "(then, as the first line of a TOML file:  #:schema envedit.schema.json)",
            "envedit schema --markdown",
        ],
    )
    parser.add_argument("--markdown", action="store_true", help="print the reference")
    arguments = parser.parse_args(argv)
    from envedit.config.reference import json_schema, markdown

    print(markdown().rstrip() if arguments.markdown else json.dumps(json_schema(), indent=1))
    return 0
