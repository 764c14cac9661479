"""The gate: readings far from their prediction are refused or softened; a sensor that stays refused is judged."""
