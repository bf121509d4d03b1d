"""Many captures, on one machine or a cluster: `avatarbuild batch`."""
