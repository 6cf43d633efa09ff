//! What the tests of gradients share.

use candle_core::{Device, Result, Tensor, Var};

/// Values between -1 and 1 that follow no pattern.
pub(crate) fn some(shape: &[usize]) -> Tensor {
    let count = shape.iter().product::<usize>();
    let values: Vec<f32> = (0..count)
        .map(|i| ((i * 7919 + 13) % 101) as f32 / 50.0 - 1.0)
        .collect();
    Tensor::from_vec(values, shape, &Device::Cpu).unwrap()
}

/// Compares the gradient of `operation` at `start` with finite differences, for a sum of its
/// results in which each counts differently.
pub(crate) fn check_gradient(start: &Tensor, operation: impl Fn(&Tensor) -> Result<Tensor>) {
    let value = |x: &Tensor| -> Tensor {
        let result = operation(x).unwrap();
        let uneven = some(result.dims());
        (result * uneven).unwrap().sum_all().unwrap()
    };
    let variable = Var::from_tensor(start).unwrap();
    let gradients = value(variable.as_tensor()).backward().unwrap();
    let analytic = gradients.get(variable.as_tensor()).expect("a gradient");
    let analytic: Vec<f32> = analytic.flatten_all().unwrap().to_vec1().unwrap();
    let values: Vec<f32> = start.flatten_all().unwrap().to_vec1().unwrap();
    let step = 3e-3f32;
    for (at, &analytic) in analytic.iter().enumerate() {
        let shifted = |by: f32| {
            let mut moved = values.clone();
            moved[at] += by;
            let moved = Tensor::from_vec(moved, start.shape(), &Device::Cpu).unwrap();
            f64::from(value(&moved).to_scalar::<f32>().unwrap())
        };
        let numeric = (shifted(step) - shifted(-step)) / f64::from(2.0 * step);
        let analytic = f64::from(analytic);
        assert!(
            (numeric - analytic).abs() < 5e-3 * (1.0 + analytic.abs()),
            "[{at}]: {numeric} against {analytic}"
        );
    }
}
