"""The examination of thermodrift: machines with independent numerics, the sealed proof, published studies repeated."""
