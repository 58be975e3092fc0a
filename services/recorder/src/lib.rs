//! MCAP recording and replay
