"""Custom GTSAM factors: pure residuals with analytic Jacobians, and thin makers."""
