"""Pages from the templates beside this file; whatever text is put into one is escaped."""

from pathlib import Path
from typing import Any

import jinja2


def filled(template: str, **values: Any) -> str:
    """The page of a template, such as report.html.j2, with its values."""
    # Escaped throughout, and a missing value is an error: names come from logs, and a page with a
    # gap where a number belongs looks like a result.
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        # Lines that hold a block alone leave no empty line in the page.
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
