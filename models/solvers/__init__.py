"""What families are made of: solvers, responses, kernels, trees and nets, each in a file of its own."""
