"""Shapes and motions of rigid bodies, independent of robot and shelf."""
