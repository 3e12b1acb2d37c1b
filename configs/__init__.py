"""YAML presets, one per thing a user runs (data only; read by ``mplicits.pipelines.training.settings``)."""
