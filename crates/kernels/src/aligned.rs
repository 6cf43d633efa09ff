//! Buffers that start on a cache line.
//!
//! A vector load that straddles two cache lines takes twice as long as one that does not. `Vec`
//! aligns its elements by their type only, so packed panels are kept in these buffers.

use std::ops::{Deref, DerefMut};

#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct CacheLine([u8; 64]);

/// Elements from a 64-byte boundary on. The length changes by [`resize`](Self::resize) only.
#[derive(Debug, Clone)]
pub struct AlignedBuffer<T> {
    lines: Vec<CacheLine>,
    len: usize,
    element: std::marker::PhantomData<T>,
}

impl<T> Default for AlignedBuffer<T> {
    fn default() -> Self {
        Self {
            lines: Vec::new(),
            len: 0,
            element: std::marker::PhantomData,
        }
    }
}

impl<T: bytemuck::Pod> AlignedBuffer<T> {
    /// A buffer of `len` zeros.
    pub fn zeroed(len: usize) -> Self {
        let mut buffer = Self::default();
        buffer.resize(len);
        buffer
    }

    /// Changes the length and keeps the elements that fit. Elements that are added are zero, or
    /// what they were when the buffer was last that long. Allocates only if the buffer has never
    /// been this long.
    pub fn resize(&mut self, len: usize) {
        let lines = (len * size_of::<T>()).div_ceil(size_of::<CacheLine>());
        if lines > self.lines.len() {
            self.lines.resize(lines, bytemuck::Zeroable::zeroed());
        }
        self.len = len;
    }
}

impl<T: bytemuck::Pod> Deref for AlignedBuffer<T> {
    type Target = [T];
    fn deref(&self) -> &[T] {
        &bytemuck::cast_slice(&self.lines)[..self.len]
    }
}

impl<T: bytemuck::Pod> DerefMut for AlignedBuffer<T> {
    fn deref_mut(&mut self) -> &mut [T] {
        &mut bytemuck::cast_slice_mut(&mut self.lines)[..self.len]
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn starts_on_a_cache_line_and_keeps_its_length() {
        let mut buffer = AlignedBuffer::<f32>::zeroed(17);
        assert_eq!((buffer.len(), buffer.as_ptr() as usize % 64), (17, 0));
        buffer[16] = 3.0;
        buffer.resize(100);
        assert_eq!(
            (
                buffer.len(),
                buffer[16],
                buffer[99],
                buffer.as_ptr() as usize % 64
            ),
            (100, 3.0, 0.0, 0)
        );
    }
}
