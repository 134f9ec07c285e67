"""Datasets of verified grasps: episodes of a policy under sampled constraints, in Parquet
shards.
"""
