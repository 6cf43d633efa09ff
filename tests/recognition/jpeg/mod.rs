//! JPEGs of every layout and with every fault that can be thought of: they show their picture, or
//! are refused with the cause, the same at every size.

mod bits;
mod cost;
mod damage;
mod encoder;
mod layouts;
mod picture;
mod refinement;
mod tolerance;
