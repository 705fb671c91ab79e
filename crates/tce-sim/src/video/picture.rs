//! Pictures made of pixels.

/// Red, green, blue.
pub type Colour = [u8; 3];

/// A picture, row by row from the top.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Picture {
    /// Pixels from left to right.
    pub width: usize,
    /// Pixels from top to bottom.
    pub height: usize,
    /// `width * height` pixels.
    pub pixels: Vec<Colour>,
}

impl Picture {
    /// A picture filled with one colour.
    pub fn new(width: usize, height: usize, colour: Colour) -> Self {
        Self { width, height, pixels: vec![colour; width * height] }
    }

    /// The pixel in column `x` and row `y`.
    pub fn pixel(&self, x: usize, y: usize) -> Colour {
        self.pixels[y * self.width + x]
    }

    /// Blends `colour` over a pixel; an opacity of 255 is opaque. Pixels outside the picture are ignored.
    pub(super) fn blend(&mut self, x: usize, y: usize, colour: Colour, opacity: u8) {
        if x < self.width && y < self.height {
            let pixel = &mut self.pixels[y * self.width + x];
            *pixel = mix(*pixel, colour, f64::from(opacity) / 255.0);
        }
    }

    /// Fills the part of a rectangle that lies in the picture.
    pub(super) fn fill(&mut self, [x, y]: [usize; 2], [width, height]: [usize; 2], colour: Colour) {
        for row in y..(y + height).min(self.height) {
            let start = row * self.width;
            self.pixels[start + x.min(self.width)..start + (x + width).min(self.width)].fill(colour);
        }
    }

    /// Copies `other` into this picture, with its top left corner at (`x`, 0). It must fit.
    pub(super) fn paste(&mut self, other: &Picture, x: usize) {
        for (row, pixels) in other.pixels.chunks_exact(other.width).enumerate() {
            let start = row * self.width + x;
            self.pixels[start..start + other.width].copy_from_slice(pixels);
        }
    }
}

/// Mixes two colours: `a` at 0, `b` at 1.
pub(super) fn mix(a: Colour, b: Colour, share: f64) -> Colour {
    std::array::from_fn(|i| (f64::from(a[i]) + share * (f64::from(b[i]) - f64::from(a[i]))).round() as u8)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_lies_outside_is_left_out() {
        let mut picture = Picture::new(4, 3, [0; 3]);
        picture.fill([2, 1], [5, 9], [9; 3]);
        picture.blend(7, 0, [255; 3], 255);
        picture.blend(0, 0, [200, 100, 0], 51);
        let lit = picture.pixels.iter().filter(|p| **p == [9; 3]).count();
        assert_eq!((lit, picture.pixel(0, 0), picture.pixel(1, 1)), (4, [40, 20, 0], [0; 3]));
    }
}
