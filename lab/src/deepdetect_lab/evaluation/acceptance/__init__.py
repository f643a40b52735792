"""Pairs of many kinds with known answers, and how an engine of guided matching answers them."""
