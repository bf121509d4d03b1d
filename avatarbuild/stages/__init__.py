"""One file a stage: artefacts and options in, one artefact out."""
