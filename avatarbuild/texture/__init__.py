"""The avatar's textures: photos onto the chart, light out of them, what no photo saw."""
