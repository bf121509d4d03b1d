"""The template laid onto a person: the morphable model, the thin shell, eyes, teeth and tongue."""
