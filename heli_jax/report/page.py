"""Pages from the templates beside this file; whatever text is put into one is escaped."""

from pathlib import Path
from typing import Any

import jinja2


def filled(template: str, **values: Any) -> str:
    """The page of a template, such as report.html.j2, with its values."""
    environment = jinja2.Environment(
        loader=jinja2.FileSystemLoader(Path(__file__).parent),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    return environment.get_template(template).render(**values)
