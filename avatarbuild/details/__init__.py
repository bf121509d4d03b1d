"""Details that follow the expression: strain of feature edges, occlusion of wrinkles, synthesis of detail maps."""
