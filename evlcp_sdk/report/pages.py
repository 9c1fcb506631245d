"""Self-contained pages of Jinja2 templates: nothing in them needs the network.

Text that is not `Markup` is escaped where it enters a page; and a page runs only the scripts that it was
written with.
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
    """Render a whole page.

    Args:
        template: Name of a template that extends `base.html`, or one itself.
        title: Plain text.
        scripts: JavaScript, run in this order once the body is there; ours alone.
        data: For the scripts, as JSON: name to values. The script element with the id `name` has the JSON of
            its values as text.
        connect: Whether scripts may connect to the server that the page comes from.
        values: Further values for the template.

    Raises:
        ValueError: A script contains the end of its element.
    """
    markups, sources = [], []
    for script in scripts:
        if re.search("</script", script, re.IGNORECASE):
            raise ValueError("a script that would end its own element")
        # As a browser normalizes it.
        script = script.replace("\r\n", "\n").replace("\r", "\n")
        digest = base64.b64encode(hashlib.sha256(script.encode()).digest()).decode()
        sources.append(f"'sha256-{digest}'")
        markups.append(Markup(script))
    policy = (
        "default-src 'none'; img-src data: blob:; base-uri 'none'; form-action 'none';"
        # Charts have inline styles.
        + (" connect-src 'self';" if connect else "")
        + " style-src 'unsafe-inline'; script-src "
        + (" ".join(sources) or "'none'")
    )
    return TEMPLATES.get_template(template).render(
        title=title, policy=Markup(policy), scripts=markups, data=data or {}, **values
    )
