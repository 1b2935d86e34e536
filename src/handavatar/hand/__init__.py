"""The parametric hand: any rig, in stages that are types (Rig, ShapedHand, PosedHand)."""
