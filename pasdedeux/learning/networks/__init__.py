"""Networks in torch: the only place that imports it, loaded when a model is trained or predicts."""
