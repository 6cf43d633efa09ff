//! Buffers that start on a cache line, so that no vector load of a packed panel straddles two.

use std::ops::{Deref, DerefMut};

#[derive(Debug, Clone, Copy, bytemuck::Pod, bytemuck::Zeroable)]
#[repr(C, align(64))]
struct CacheLine([u8; 64]);

/// Elements from a 64-byte boundary on, zeroed when made. The length is fixed by
/// [`resize`](Self::resize).
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

    /// Changes the length, keeping what fits; elements gained are zero or what a longer life left
    /// there. Allocates only when it has never been this long.
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
