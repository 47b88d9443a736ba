"""Code sequences from any sequence model: beam search and sampling."""
