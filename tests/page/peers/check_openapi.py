#!/usr/bin/env python3
"""Checks a description in OpenAPI against the specification.

    check_openapi.py < DOCUMENT
"""

import json
import sys

from openapi_spec_validator import OpenAPIV31SpecValidator

errors = [error.message for error in OpenAPIV31SpecValidator(json.load(sys.stdin)).iter_errors()]
sys.exit("\n".join(errors) or None)
