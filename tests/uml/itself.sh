# Runs inside the guest: one test of the program that booted it. TESTS = that program, TEST = the test.
export DINRAIL_GUEST=1
# What the host has, the guest has.
export DINRAIL_NO_SKIP=1
cd /tmp
"$TESTS" "$TEST" --exact --nocapture
