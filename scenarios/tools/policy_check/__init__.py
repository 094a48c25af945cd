"""What users of a policy get wrong and never notice, asked of the policy itself as a black box."""
