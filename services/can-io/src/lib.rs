//! Raw CAN frames and signals to and from the process image
