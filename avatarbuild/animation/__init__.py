"""Pictures of a finished avatar in motion."""
