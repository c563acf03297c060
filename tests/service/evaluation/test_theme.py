"""Figures find the fonts that matplotlib ships, whatever list of fonts it has."""

from matplotlib import font_manager

from koop_service.evaluation import theme


def test_a_list_without_the_shipped_fonts_is_completed(monkeypatch):
    whole = font_manager.fontManager.ttflist
    lacking = [font for font in whole if not font.name.startswith(("cm", "STIX"))]
    monkeypatch.setattr(font_manager.fontManager, "ttflist", lacking)
    theme._complete_fonts.cache_clear()
    with theme.styled():
        names = {font.name for font in font_manager.fontManager.ttflist}
    assert names >= {"cmss10", "cmr10", "cmsy10", "STIXGeneral", "DejaVu Sans Display"}
