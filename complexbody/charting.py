def draw(chart, path): pass
