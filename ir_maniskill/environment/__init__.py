"""The Environment block: Instructional Set, Reward Generator, Robot (Sec. III-A)."""
