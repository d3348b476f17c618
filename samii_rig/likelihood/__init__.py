"""The likelihood of whole records: a model's prediction of every sample, its start and its cut-off
end included, against what was recorded."""
