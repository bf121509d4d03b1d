"""Other head models as templates: readers of ICT-FaceKit, FLAME and BFM, and the wrap of the shipped head onto them.

The user's files are only read. A reader returns a ForeignHead; `transfer.to_template` makes it a Template.
"""
