"""Self-contained pages of Jinja2 templates: nothing in them asks the network.

What is not `Markup` is plain text and is escaped where it enters a page, whatever wrote it; and a page lets
no script run but those that it was written with.
"""

import base64
import hashlib
import json
import re
from collections.abc import Mapping, Sequence
from typing import Any

from jinja2 import Environment, PackageLoader, StrictUndefined, Template
from markupsafe import Markup

TEMPLATES = Environment(
    loader=PackageLoader("evlcp_sdk.report"),
    autoescape=True,
    undefined=StrictUndefined,
    trim_blocks=True,
    lstrip_blocks=True,
)
TEMPLATES.policies["json.dumps_kwargs"] = {"allow_nan": False}
TEMPLATES.filters["pretty"] = lambda values: json.dumps(values, indent=1, sort_keys=True)
TEMPLATES.filters["percent"] = lambda value, of: f"{100 * value / of:.2f}"


def render_page(
    template: str | Template,
    title: str,
    scripts: Sequence[str] = (),
    data: Mapping[str, Any] | None = None,
    *,
    connect: bool = False,
    **values: Any,
) -> str:
    """A whole page.

    Args:
        template: Name of a template that extends `base.html`, or one itself.
        title: Plain text.
        scripts: JavaScript, run in this order once the body is there; written by us, nothing of it by others.
        data: What the scripts read, as JSON: name to values. The text of the script element with the id
            `name` is the JSON of its values.
        connect: Scripts may talk to the server that the page comes from.
        values: What the template shows beside.

    Raises:
        ValueError: A script holds what would end its element.
    """
    held, sources = [], []
    for script in scripts:
        if re.search("</script", script, re.IGNORECASE):
            raise ValueError("a script that would end its own element")
        # As a browser reads it.
        script = script.replace("\r\n", "\n").replace("\r", "\n")
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        sources.append(f"'sha256-{digest}'")
        held.append(Markup(script))
    policy = (
        "default-src 'none'; img-src data: blob:; base-uri 'none'; form-action 'none';"
        # Charts style themselves.
        + (" connect-src 'self';" if connect else "")
        + " style-src 'unsafe-inline'; script-src "
        + (" ".join(sources) or "'none'")
    )
    return TEMPLATES.get_template(template).render(
        title=title, policy=Markup(policy), scripts=held, data=data or {}, **values
    )
