"""The JSON Schema of scenario files, for editors that complete and check YAML while one types."""

from typing import Any

from sim.site import site_names

from .judge import OPERATORS
from .metrics import METRICS
from .scenario import Scenario


def scenario_schema() -> dict[str, Any]:
    """Give the schema: what the model says, and the names of sites and metrics with their units and meaning."""
    schema = Scenario.model_json_schema()
    operators = "|".join(sorted(OPERATORS, key=len, reverse=True))
    schema["properties"]["site"]["enum"] = site_names()
    schema["properties"]["criteria"] |= {
        "additionalProperties": False,
        "properties": {
            name: {
                "type": "string",
                "description": f"{metric.doc} [{metric.unit}]" if metric.unit else metric.doc,
                "pattern": rf"^\s*({operators}) +\S+\s*$",
            }
            for name, metric in sorted(METRICS.items())
        },
    }
    return {"$schema": "https://json-schema.org/draft/2020-12/schema"} | schema | {"title": "Fairway scenario"}
