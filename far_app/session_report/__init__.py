"""A page on recorded sessions for `far report SESSION...`: one HTML file, nothing fetched from anywhere.

outcomes   trials as they ended, by what was compared; success by attempt, paired differences
failures   each failed attempt: the chunk to blame, frames before and after it, its value curve
page       all of it as HTML
"""
