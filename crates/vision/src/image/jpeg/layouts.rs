//! How components share the picture: which sampling factors can be decoded.

use super::fault::Fault;
use super::frame::Frame;
use super::syntax::Layout;

/// Brings the sampling factors into the form that the libraries decode right.
///
/// # Errors
/// Factors that do not divide the largest one, which viewers do not show either; and two
/// combinations with a factor of 2 beside one of 4 that no encoder is known to write.
pub(super) fn simplify(layout: &mut Layout<'_>) -> Result<(), Fault> {
    let is_alone = layout.scans.iter().all(|scan| scan.parts.len() == 1);
    let frame = &mut layout.frame;
    if is_alone {
        reduce(frame);
    }
    let largest = frame.largest_sampling();
    for component in &frame.components {
        let (horizontal, vertical) = component.sampling;
        let divides = largest.0.is_multiple_of(horizontal) && largest.1.is_multiple_of(vertical);
        if !divides {
            return Err(unsupported(frame));
        }
    }
    // `jpeg-decoder` takes such a component to have whole units of blocks in scans of its own.
    let mut scans = layout.scans.iter().filter(|scan| scan.parts.len() == 1);
    let is_misread = scans.any(|scan| {
        let component = &frame.components[scan.parts[0].component];
        let is_between = |factor: u32, largest: u32| 1 < factor && factor < largest;
        is_between(component.sampling.0, largest.0) || is_between(component.sampling.1, largest.1)
    });
    if is_misread {
        return Err(unsupported(frame));
    }
    Ok(())
}

fn unsupported(frame: &Frame) -> Fault {
    let factors = frame.components.iter().map(|component| {
        let (horizontal, vertical) = component.sampling;
        format!("{horizontal}x{vertical}")
    });
    Fault::Sampling(factors.collect::<Vec<_>>().join(", "))
}

/// Divides the factors by what is common to them.
///
/// If each scan has one component, the factors say nothing about the order of the blocks but only
/// how large the components are to each other, so the picture stays the same.
fn reduce(frame: &mut Frame) {
    let common = |factors: fn(&(u32, u32)) -> u32| {
        let all = frame
            .components
            .iter()
            .map(|component| factors(&component.sampling));
        all.reduce(greatest_common_divisor).unwrap_or(1)
    };
    let (horizontal, vertical) = (common(|sampling| sampling.0), common(|sampling| sampling.1));
    for component in &mut frame.components {
        component.sampling.0 /= horizontal;
        component.sampling.1 /= vertical;
    }
}

fn greatest_common_divisor(a: u32, b: u32) -> u32 {
    if b == 0 {
        a
    } else {
        greatest_common_divisor(b, a % b)
    }
}
