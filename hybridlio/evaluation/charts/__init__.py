"""The report's interactive charts, as figures of Plotly: plain dictionaries that a page draws."""
