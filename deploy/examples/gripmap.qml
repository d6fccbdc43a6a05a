<!DOCTYPE qgis PUBLIC 'http://mrcc.com/qgis.dtd' 'SYSTEM'>
<qgis version="3.34" styleCategories="Symbology">
 <renderer-v2 type="RuleRenderer" enableorderby="0" symbollevels="0" forceraster="0">
  <rules key="grip">
   <rule key="r0" symbol="0" label="ice: 0 to 0.25" filter="&quot;mu&quot; &gt;= 0 AND &quot;mu&quot; &lt; 0.25"/>
   <rule key="r1" symbol="1" label="snow: 0.25 to 0.4" filter="&quot;mu&quot; &gt;= 0.25 AND &quot;mu&quot; &lt; 0.4"/>
   <rule key="r2" symbol="2" label="slush: 0.4 to 0.5" filter="&quot;mu&quot; &gt;= 0.4 AND &quot;mu&quot; &lt; 0.5"/>
   <rule key="r3" symbol="3" label="wet: 0.5 to 0.7" filter="&quot;mu&quot; &gt;= 0.5 AND &quot;mu&quot; &lt; 0.7"/>
   <rule key="r4" symbol="4" label="damp: 0.7 to 0.8" filter="&quot;mu&quot; &gt;= 0.7 AND &quot;mu&quot; &lt; 0.8"/>
   <rule key="r5" symbol="5" label="dry: 0.8 to 2" filter="&quot;mu&quot; &gt;= 0.8 AND &quot;mu&quot; &lt; 2"/>
   <rule key="unknown" symbol="6" label="not measured: only lower bounds" filter="&quot;mu&quot; IS NULL"/>
   <rule key="known" symbol="1" label="slippery, without a value" filter="&quot;mu&quot; IS NULL AND &quot;p_slippery&quot; &gt; 0.5"/>
  </rules>
  <symbols>
   <symbol type="fill" name="0" alpha="1"><layer class="SimpleFill" enabled="1" locked="0" pass="0"><Option type="Map">
    <Option type="QString" name="color" value="47,0,91,255"/><Option type="QString" name="outline_style" value="no"/><Option type="QString" name="style" value="solid"/></Option></layer></symbol>
   <symbol type="fill" name="1" alpha="1"><layer class="SimpleFill" enabled="1" locked="0" pass="0"><Option type="Map">
    <Option type="QString" name="color" value="147,19,91,255"/><Option type="QString" name="outline_style" value="no"/><Option type="QString" name="style" value="solid"/></Option></layer></symbol>
   <symbol type="fill" name="2" alpha="1"><layer class="SimpleFill" enabled="1" locked="0" pass="0"><Option type="Map">
    <Option type="QString" name="color" value="196,69,82,255"/><Option type="QString" name="outline_style" value="no"/><Option type="QString" name="style" value="solid"/></Option></layer></symbol>
   <symbol type="fill" name="3" alpha="1"><layer class="SimpleFill" enabled="1" locked="0" pass="0"><Option type="Map">
    <Option type="QString" name="color" value="244,122,61,255"/><Option type="QString" name="outline_style" value="no"/><Option type="QString" name="style" value="solid"/></Option></layer></symbol>
   <symbol type="fill" name="4" alpha="1"><layer class="SimpleFill" enabled="1" locked="0" pass="0"><Option type="Map">
    <Option type="QString" name="color" value="246,178,63,255"/><Option type="QString" name="outline_style" value="no"/><Option type="QString" name="style" value="solid"/></Option></layer></symbol>
   <symbol type="fill" name="5" alpha="1"><layer class="SimpleFill" enabled="1" locked="0" pass="0"><Option type="Map">
    <Option type="QString" name="color" value="246,236,115,255"/><Option type="QString" name="outline_style" value="no"/><Option type="QString" name="style" value="solid"/></Option></layer></symbol>
   <symbol type="fill" name="6" alpha="1"><layer class="SimpleFill" enabled="1" locked="0" pass="0"><Option type="Map">
    <Option type="QString" name="color" value="136,136,136,255"/><Option type="QString" name="outline_style" value="solid"/><Option type="QString" name="outline_color" value="136,136,136,255"/><Option type="QString" name="outline_width" value="0.1"/><Option type="QString" name="style" value="b_diagonal"/></Option></layer></symbol>
  </symbols>
 </renderer-v2>
 <layerGeometryType>2</layerGeometryType>
</qgis>
