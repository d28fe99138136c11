"""Pages: the templates, and what all of them may use."""

from functools import cache
from typing import Any

import jinja2
from markupsafe import Markup

from oodil.pipeline.report import formats, looks


def page(template: str, **values: Any) -> str:
    """Return the HTML of a page that needs no other file and follows the reader's choice of light or dark."""
    return _environment().get_template(template).render(values)


@cache
def _environment() -> jinja2.Environment:
    environment = jinja2.Environment(
        loader=jinja2.PackageLoader("oodil.pipeline.report"),
        autoescape=True,
        undefined=jinja2.StrictUndefined,
        trim_blocks=True,
        lstrip_blocks=True,
    )
    environment.filters |= {each.__name__: each for each in (formats.plural, formats.returned, formats.percent)}
    environment.filters["steps"] = formats.count
    environment.filters["on_any_paper"] = lambda text: Markup(looks.on_any_paper(str(text)))
    environment.globals |= {"training_colors": looks.TRAINING, "dark": looks.DARK}
    return environment
