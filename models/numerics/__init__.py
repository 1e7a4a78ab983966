"""Numerical methods shared by families: solvers, lag responses, kernels, trees and nets."""
