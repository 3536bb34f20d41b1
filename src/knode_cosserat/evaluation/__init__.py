"""Drawing behind `knode_cosserat.figures`, animations, and figures of recordings and residuals."""
