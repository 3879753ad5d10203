"""Mutation testing: are small mistakes, put into the code one at a time, noticed by its tests?"""
