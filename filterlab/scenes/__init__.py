"""Scenes: files that say what a picture shows and how, and what becomes of them.

file ──model──▶ Scene ──build──▶ Prepared ──render──▶ image
                                    └──plan──▶ what it will take
"""
