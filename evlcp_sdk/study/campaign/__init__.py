"""The pages and charts of a campaign."""
