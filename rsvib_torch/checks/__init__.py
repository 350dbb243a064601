"""Checks of what users give: values, arrays, arguments of functions, groups of options."""
