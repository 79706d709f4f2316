"""Ablation of the estimator: each rule is switched off alone, and short recordings say what that moves."""
