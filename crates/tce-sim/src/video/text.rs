//! Draws text on a picture.

use noto_sans_mono_bitmap::{FontWeight, RasterHeight, get_raster, get_raster_width};

use super::picture::{Colour, Picture};

/// The style of a line of text.
#[derive(Clone, Copy, Debug)]
pub(super) struct Style {
    weight: FontWeight,
    size: RasterHeight,
    colour: Colour,
}

impl Style {
    /// A style with a letter size that suits a picture of `rows` pixels.
    pub fn regular(rows: usize, colour: Colour) -> Self {
        let weight = FontWeight::Regular;
        let size = if rows < 600 { RasterHeight::Size16 } else { RasterHeight::Size24 };
        Self { weight, size, colour }
    }

    /// The same in bold.
    pub fn bold(rows: usize, colour: Colour) -> Self {
        Self { weight: FontWeight::Bold, ..Self::regular(rows, colour) }
    }

    /// Distance between two lines, in pixels.
    pub fn line(&self) -> usize {
        self.size.val() + 2
    }

    /// Distance between two letters, in pixels.
    pub fn advance(&self) -> usize {
        get_raster_width(self.weight, self.size)
    }
}

/// Writes `text` with its top left corner at (`x`, `y`). Text that does not fit is cut off.
pub(super) fn write(picture: &mut Picture, x: usize, y: usize, text: &str, style: Style) {
    for (k, letter) in text.chars().enumerate() {
        let left = x + k * style.advance();
        // The font has all letters that occur in labels.
        let Some(raster) = get_raster(letter, style.weight, style.size) else { continue };
        for (row, pixels) in raster.rows().enumerate() {
            for (column, &ink) in pixels.iter().enumerate() {
                picture.blend(left + column, y + row, style.colour, ink);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn letters_stay_in_their_box_and_in_the_picture() {
        let style = Style::regular(360, [0, 0, 0]);
        let mut picture = Picture::new(60, 30, [255; 3]);
        write(&mut picture, 5, 4, "H×", style);
        let dark: Vec<_> = (0..30)
            .flat_map(|y| (0..60).map(move |x| (x, y)))
            .filter(|&(x, y)| picture.pixel(x, y) != [255; 3])
            .collect();
        assert!(dark.len() > 20);
        let right = 5 + 2 * style.advance();
        assert!(dark.iter().all(|&(x, y)| (5..right).contains(&x) && (4..20).contains(&y)), "{dark:?}");
        // Text beyond the edge is cut off without a panic.
        write(&mut picture, 55, 25, "edge", style);
    }
}
