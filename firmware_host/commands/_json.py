"""Commands with `--json`: errors are JSON on stdout, besides the line on stderr."""

from typing import Annotated, Any

import typer
from typer.core import TyperCommand

from evlcp_sdk.cli._common import print_json
from evlcp_sdk.errors import explain_fault

AsJson = Annotated[bool, typer.Option("--json", help="JSON on stdout, faults too.")]


def fault_table(fault: BaseException) -> dict[str, Any]:
    """An error as plain values: kind, exit code, message."""
    message, code = explain_fault(fault)
    return {"error": {"kind": type(fault).__name__, "exit_code": code, "message": message}}


class JsonCommand(TyperCommand):
    """A command that prints `{"error": ...}` on stdout if it fails with `--json`."""

    def parse_args(self, ctx: Any, args: list[str]) -> Any:
        """Parse; print an error of usage as JSON."""
        wanted = "--json" in args
        try:
            return super().parse_args(ctx, args)
        except Exception as fault:
            if wanted and hasattr(fault, "format_message"):
                message = fault.format_message()
                print_json({"error": {"kind": "UsageError", "exit_code": 2, "message": message}})
            raise

    def invoke(self, ctx: Any) -> Any:
        """Run; print an error as JSON unless stdout itself failed."""
        try:
            return super().invoke(ctx)
        except (typer.Exit, typer.Abort):
            raise
        except Exception as fault:
            if ctx.params.get("as_json") and not (isinstance(fault, OSError) and fault.filename is None):
                print_json(fault_table(fault))
            raise
